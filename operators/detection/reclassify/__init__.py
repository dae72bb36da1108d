"""Classes of small things, by close-ups in the image's own resolution."""

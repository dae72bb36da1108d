"""What small things are, by close-ups in the image's own resolution."""

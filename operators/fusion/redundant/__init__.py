"""Several sensors that measure one thing: combined by covariance, and those that contradict named."""

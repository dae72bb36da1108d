"""Estimation: least squares, particles and the distributions that judge them."""

"""Textures of surfaces, painted by name, and the atlas that holds them."""

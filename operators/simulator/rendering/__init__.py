"""Rendering of a world for cameras and lidars: meshes, light, rays."""

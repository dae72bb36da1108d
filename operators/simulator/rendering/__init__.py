"""What a camera or a lidar sees of a world: meshes, light, rays."""

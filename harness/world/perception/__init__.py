"""What one vehicle perceives of the world: rays, sensors, scene graph, camera pictures."""

"""From the world to what one vehicle knows of it: rays, sensors, scene graph."""

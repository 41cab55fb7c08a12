"""What a vehicle knows: rays, sensors with noise, and the scene graph made of them."""

"""Pictures with matplotlib: a scene from above, and what every figure shares."""

"""Frozen datasets: scenes taken from the simulator, and where every action leads."""

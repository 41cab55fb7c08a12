"""Frozen datasets: scenes taken out of the simulator, with where every action leads."""

"""Frozen datasets: scenes taken out of the simulator, with what every action leads to."""

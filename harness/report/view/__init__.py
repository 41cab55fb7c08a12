"""A folder of runs in a browser on this machine."""

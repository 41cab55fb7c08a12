"""A folder of runs in the browser of whoever sits at this machine."""

"""What layouts teach, drawn once for all tests of a worker."""

from functools import cache

from harness.training import lessons

drawn_once = cache(lessons.decision_points)

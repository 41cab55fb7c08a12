"""Driving live: every decision is asked from what is seen at that moment, and acts when it is ready."""

"""Conditions by the dozen: a source of intents is played at every point of a grid,
and drawn in panels.
"""

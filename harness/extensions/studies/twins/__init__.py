"""Metamorphic tests: what must hold of the answers to a question and to its twin."""

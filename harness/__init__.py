"""SwarmDrive Harness: evaluates prompts, parsing and coordination in cooperative driving."""

__version__ = "0.1.0"

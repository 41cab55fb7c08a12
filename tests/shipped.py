"""What ships with the harness, for the tests that list it."""

PROMPTS = ["paper", "v1", "v10", "v2", "v3", "v4", "v5", "v6", "v7", "v8", "v9"]

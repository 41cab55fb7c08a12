"""Two finished runs compared: what changed, by how much, and whether a gate fails."""

"""Two finished runs held against each other: what changed, by how much, and whether a gate fails."""

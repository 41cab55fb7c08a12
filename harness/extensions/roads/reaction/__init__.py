"""What it is worth that recorded others react: every course in both worlds."""

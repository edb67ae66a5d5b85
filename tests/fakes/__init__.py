"""Stand-ins for programs and for what the system does."""

"""Between our scenes and those of other programs."""

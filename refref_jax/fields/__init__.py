"""Fields of density and colour. They know positions and directions, never rays."""

"""Fields of density and colour, as functions of position and direction."""

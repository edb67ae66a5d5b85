"""What light does at surfaces, and the paths that it takes."""

"""The viewer in a browser: what it shows, when it draws, and the server (`experiments.view`)."""

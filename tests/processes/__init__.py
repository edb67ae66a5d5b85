"""Programs that tests start, and how they start them."""

"""Scenes, models, cameras, records and files made for tests."""

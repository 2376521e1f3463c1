"""Upkeep of a console, and news for its people: notifications, facts of the system, support bundles."""

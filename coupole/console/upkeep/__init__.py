"""Upkeep of a console: notifications, facts of the system, support bundles."""

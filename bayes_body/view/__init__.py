"""Pictures of sessions and runs."""

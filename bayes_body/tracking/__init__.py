"""A model, a kernel and a session make draws."""

"""Particle belief propagation: messages, proposals, schedules and joint draws."""

"""Joint angles and gait events as clinicians read them, of the draws of a posterior."""

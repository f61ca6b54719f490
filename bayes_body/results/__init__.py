"""What the draws say: ArviZ trees, a run's folder, figures, and clinical angles."""

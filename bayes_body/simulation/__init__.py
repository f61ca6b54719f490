"""An independent renderer: its own people, filmed by its own cameras, with the true poses."""

"""The independent renderer: people of its own making, filmed by cameras of its own, with the truth beside."""

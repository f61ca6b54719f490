"""The language of models: factors over named variables, transitions, and the density that their product is."""

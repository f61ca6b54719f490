"""An independent renderer, which films simulated people with known poses by simulated cameras."""

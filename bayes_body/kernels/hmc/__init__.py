"""The hybrid Monte Carlo filter: chains, their starts, mass matrices and adaptation."""

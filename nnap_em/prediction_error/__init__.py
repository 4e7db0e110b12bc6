"""Multi-step prediction errors, a fit to them, and the covariance that they require."""

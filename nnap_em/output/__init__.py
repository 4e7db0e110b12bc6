"""Products of a fit: figures (`plots`), models for programs that have no JAX (`export`), reports (`report`)."""

"""E-step, M-step and their loop; identify, check, predict and store."""

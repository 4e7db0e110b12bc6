"""What to run on the machine next: the inputs that answer the open questions best."""

"""What a fit leaves unexplained: innovations and their tests, the missing force, disturbances from outside."""

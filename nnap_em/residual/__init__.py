"""Innovations of a fit and their tests, the generalised force that it lacks, external disturbances."""

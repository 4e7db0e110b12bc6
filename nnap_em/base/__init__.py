"""Arrays, whole files, devices, the journal of a long run: what every other wing stands on."""

"""Arrays, whole files, devices and the journal of a long run, which all other wings use."""

"""Physics, effects, friction and noise as one state-space model; laws of a learned curve; simulation."""

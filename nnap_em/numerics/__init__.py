"""Small dense algebra, one sample interval of an ODE, elementary functions, and work spread over devices."""

"""Search for the effects that a fitted model lacks: screening, refits, the rule that decides, and the findings."""

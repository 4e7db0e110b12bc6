"""What a fitted model lacks: residuals, screening, refits, the search and its findings."""

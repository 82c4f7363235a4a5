"""What rules for mixtures share: the moments of the sources, and means of densities part by part."""

"""All readings against one map: what flipping each cell gains, kept up to date."""

"""What follows from a map about sensors: model parameters with standard errors, and the health of each sensor."""

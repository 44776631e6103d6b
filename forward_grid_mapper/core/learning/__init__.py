"""What a map says of the sensors: model parameters with their standard errors, and the health of each sensor."""

"""Training without labels: pairs made on the device, one jitted step, a loop that can be killed and resumed."""

"""Fitting splats to photographs: the step, its loss and optimiser, growth, schedule."""

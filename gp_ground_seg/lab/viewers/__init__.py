"""A scan in the browser, with sliders for the parameters."""

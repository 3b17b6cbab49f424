"""Parameters: their one declaration, files, presets."""

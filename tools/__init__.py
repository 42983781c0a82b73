"""Commands, files, progress and drawing: the only place with input and output."""

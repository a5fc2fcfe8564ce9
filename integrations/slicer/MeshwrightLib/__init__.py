"""What the three Meshwright modules share. `checks`, `command_line` and `results` need no Qt and are tested without Slicer's window."""

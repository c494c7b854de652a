"""Drawing: 3-D playback, plots and the report."""

"""Train detection on streams of waveform blocks: pure NumPy and SciPy."""

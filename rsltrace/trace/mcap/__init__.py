"""MCAP files, read with distrust and written in bulk. Traces and bags stand on this layer."""

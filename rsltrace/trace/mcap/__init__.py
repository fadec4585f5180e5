"""Reading and writing MCAP files, also damaged or hostile ones. Traces and bags use this layer."""

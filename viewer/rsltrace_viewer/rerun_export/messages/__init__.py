"""The messages of a run in Rerun's terms: shapes, images, transforms, curves, tracks."""

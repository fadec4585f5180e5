"""How one value of a job is written and checked: times, sizes, names, paths, parameters."""

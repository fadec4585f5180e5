"""From a job to what a run needs: entries, bags, network, scheduling, guard."""

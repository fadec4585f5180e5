"""Quality of service: who connects to whom, deadlines and liveliness, and what came of them."""

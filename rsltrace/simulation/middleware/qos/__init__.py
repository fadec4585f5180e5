"""Quality of service: compatibility, deadlines, liveliness and their statuses."""

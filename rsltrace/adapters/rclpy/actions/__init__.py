"""Actions: clients, servers and goals, made of services and topics."""

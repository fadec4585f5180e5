"""The simulated middleware: graph, QoS and transport, in place of DDS."""

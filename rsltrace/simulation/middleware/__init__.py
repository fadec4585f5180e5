"""Who talks to whom, with which QoS, and how messages get there: what DDS is to a robot."""

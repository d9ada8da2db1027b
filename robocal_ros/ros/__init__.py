"""What all nodes are made of: base, parameters, endpoints, QoS, diagnostics."""

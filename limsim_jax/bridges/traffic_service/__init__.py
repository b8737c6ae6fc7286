"""Traffic as a service: a gRPC server in the shape of AlpaSim's traffic service."""

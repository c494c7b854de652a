"""What capture, retargeting and a robot tell each other: messages, datagrams, sockets, rates, latency."""

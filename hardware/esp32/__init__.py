"""Mini Pupper 2: the proxy on its ESP32, which owns the servo bus."""

"""Commands about a robot: its bus, its joints, its emulation."""

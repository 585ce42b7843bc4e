"""One module per program: `pupper-sysid`, `pupper-train`, `pupper-play` and the others."""

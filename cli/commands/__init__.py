"""One module per subcommand of `pupper-sysid`."""

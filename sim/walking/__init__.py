"""The vectorised walking environment, and one robot that walks behind a bus."""

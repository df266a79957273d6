"""One folder a stage; each turns typed records into typed records with a pure function `run`."""

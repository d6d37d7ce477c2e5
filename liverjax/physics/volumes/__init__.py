"""Volume changes held on average over neighbouring elements, against locking."""

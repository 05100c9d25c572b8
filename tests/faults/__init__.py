"""What can go wrong around a run, tried stage by stage: kills, full disks, and other faults."""

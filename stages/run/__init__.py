"""Run folders: manifests, digests, what runs again and why, and the run itself."""

"""What a run leaves: its folder, results, log and summary; live runs and replays as they were live."""

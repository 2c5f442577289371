"""What is checked and proposed before a run: scenario, prior, recordings, default tasks, the installation."""

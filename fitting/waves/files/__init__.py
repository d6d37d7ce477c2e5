"""Read wave data from files of several formats, and unwrap phases."""

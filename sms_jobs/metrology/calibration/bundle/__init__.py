"""Bundle adjustment in object space over all sensors, poses and artefacts."""

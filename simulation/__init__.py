"""The world: sea, platform, vehicle, sensors, renderer, scenarios and faults. One truth for tests and benchmarks."""

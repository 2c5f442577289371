"""The closed loop: one period at a time, simulated or in real time, with faults, and with a guard that reacts."""

"""What users call: experiments, sweeps, results, single worlds and a step-by-step environment."""

"""Run a method: `runner` and `worker`, in a `sandbox`; an `engine` says where jobs run."""

"""Many scans to one model: pairs proposed and registered, wrong edges rejected, poses optimised together."""

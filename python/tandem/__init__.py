"""Two robot arms that learn with advice from a policy for one: environments and policies of Tandem."""

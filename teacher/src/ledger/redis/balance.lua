-- How an account stands.

return {balance(), {}, {}}

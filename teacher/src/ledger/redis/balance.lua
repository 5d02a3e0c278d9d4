-- Returns the balance of an account.

return {balance(), {}, {}}

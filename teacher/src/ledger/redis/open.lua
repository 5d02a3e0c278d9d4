-- Opens an account unless it is open. KEYS: the account. ARGV: budget, strategy. Returns the account's fields.

local fields = redis.call('HMGET', KEYS[1], 'budget', 'strategy', 'spent', 'leased')
if fields[1] then
  return {fields, {}, {}}
end
redis.call('HSET', KEYS[1], 'budget', ARGV[1], 'strategy', ARGV[2], 'spent', '0', 'leased', '0')
return {{ARGV[1], ARGV[2], '0', '0'}, {}, {}}

-- Returns the unspent units of episodes to the budget. ARGV: episodes. Episodes without an open lease have none.

for i = 1, #ARGV do
  local lease = load_lease(ARGV[i])
  if lease and not lease.settled then
    lease.settled = true
    leased = leased - (lease.units - lease.spent)
    save_lease(ARGV[i], lease)
  end
end
save_account()
return {balance(), {}, {}}

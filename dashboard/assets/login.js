// Exchanges the token for a cookie that scripts cannot read.
const form = document.getElementById("login");
const message = document.getElementById("login-error");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const token = document.getElementById("token").value.trim();
  if (/[^!-~]/.test(token)) {
    message.textContent = "The token is wrong: it has a character that no token has.";
    return;
  }
  try {
    const headers = { authorization: `Bearer ${token}`, "x-tandem-action": "login" };
    const response = await fetch("/login", { method: "POST", headers });
    if (response.ok) location.reload();
    else if (response.status === 401) message.textContent = "The token is wrong.";
    else message.textContent = `The service refuses: ${(await response.text()).trim()}`;
  } catch {
    message.textContent = "The service does not answer.";
  }
});
